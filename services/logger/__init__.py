"""The recorder of realms, which hosts the router."""
