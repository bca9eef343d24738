"""Everything that touches Rerun."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from viz.timeline import write_log_timeline, write_timeline
    from viz.viewer import show

__all__ = ["show", "write_log_timeline", "write_timeline"]


def __getattr__(name: str) -> Any:  # lazy: Rerun takes most of a second to import
    if name == "show":
        from viz.viewer import show

        return show
    if name in __all__:
        from viz import timeline

        return getattr(timeline, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
