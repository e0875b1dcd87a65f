"""Tables of other programs: CSV, Parquet and Excel in; CSV and Parquet out."""
