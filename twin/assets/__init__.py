"""The asset database: type → object-specific data set, ID → instance-specific data set."""
