"""Prediction of a survey's accuracy and of the damage that it detects."""
