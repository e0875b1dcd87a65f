"""What all inference is made of: sensitivities, covariances and how sure is sure enough."""
