"""An estimation bench: which estimator to trust with nonlinear measurements."""
