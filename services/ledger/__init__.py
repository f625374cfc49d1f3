"""Results on disk: what a worker has published, and which crossings only recordings hold."""
