"""Is truck, site file and recording fit for a survey? Looked at before it is too late."""
