"""What `recipes.report` and the end of a run are made of: reading a folder, drawing, laying out a page."""
