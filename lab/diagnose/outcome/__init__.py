"""What a diagnosis reports: findings, residual pictures, improved models, the next capture."""
