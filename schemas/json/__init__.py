"""JSON schemas of the site file and of results, for editors and for other programs' validators."""
