"""`[import]` of a site file: the realm that imports of one campaign share."""

from schemas.site_numbers import Identifier, Table


class Import(Table):
    """Table of how imported drives are filed; it does not concern what they measure."""

    name: Identifier
    """Realm import-NAME of every drive that is imported with this site file."""
