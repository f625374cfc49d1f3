"""The forward problem: half-car, beam, road, sensors, and both driven together."""
