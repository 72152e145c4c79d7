"""What is told of a diagnosis: findings, pictures, improved models, the next capture."""
