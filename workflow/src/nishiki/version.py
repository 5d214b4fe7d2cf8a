"""The project's version, in a module of its own so that reading it loads nothing else."""

PROJECT_VERSION = "0.1.0"
