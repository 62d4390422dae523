"""What recorded drives say of each vehicle's sensors, as Gaussian rows with covariance."""
