"""The parts of all inference: sensitivities, covariances and confidence levels."""
