"""Simulators: logs with known faults, from first principles."""

from __future__ import annotations
