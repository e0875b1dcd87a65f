"""A live digital twin of pneumatic vacuum ejectors."""
