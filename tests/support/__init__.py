"""What several tests share, one purpose a module: made-up clips, walks and files, and readers of results."""
