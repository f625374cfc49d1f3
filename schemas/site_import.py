"""`[import]` of a site file: the realm that imports of one campaign share."""

from schemas.site_numbers import Identifier, Table


class Import(Table):
    """Table that sets the realm of imported drives; it does not affect their measurements."""

    name: Identifier
    """Realm import-NAME of every drive that is imported with this site file."""
