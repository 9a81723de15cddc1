"""How far the Gaussians that estimators report are from the posterior of a few trials."""
