"""What a truck measured, from CSV files, other people's recordings or a simulation."""
