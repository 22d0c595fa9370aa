"""Entry points: the only place with an argument parser, a logger, a device choice and files on disk."""
