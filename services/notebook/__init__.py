"""What a notebook asks for, without a bus: read, identify, simulate (`import driveby`)."""
