"""Long studies of the estimator on simulated drives whose noise is what the configuration says."""
