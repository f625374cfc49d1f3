"""Export of measurements and results for other programs: CSV, Parquet, GeoJSON."""
