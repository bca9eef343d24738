"""The pipeline: recipes, fitting, running, the detector store, the command line."""
