"""Property-based tests have no deadline: how fast a machine is says nothing about the code."""

from hypothesis import settings

settings.register_profile("dynoscope", deadline=None)
settings.load_profile("dynoscope")
