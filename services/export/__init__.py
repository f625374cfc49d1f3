"""Writes what was measured and found in forms that other programs read: CSV, Parquet, GeoJSON."""
