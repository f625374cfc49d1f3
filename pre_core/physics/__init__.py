"""The forward problem: half-car, beam, road, sensors, and the coupled simulation."""
