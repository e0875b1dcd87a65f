"""The model and its data in the forms other tools take."""
