"""The words of the command ``coim``, one module each."""
