"""What a survey will tell, before anyone drives: by simulated crossings of a site file."""
