"""Whether the covariance that another program reports describes its errors."""
