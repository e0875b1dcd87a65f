"""Tables of other programs: CSV and Parquet in and out."""
