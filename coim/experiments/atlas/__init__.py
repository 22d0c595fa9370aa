"""The atlas: one page with every body of a run, and a robot that walks in it."""
