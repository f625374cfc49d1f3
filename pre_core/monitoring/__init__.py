"""A bridge over years: what crossings say of its change, and when that is more than chance."""
