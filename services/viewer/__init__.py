"""Pictures of what was recorded and found: a figure as PNG, a recording for the Rerun viewer."""

from services.viewer.view import view_command

__all__ = ["view_command"]
