"""What a run leaves for people to read: one model of its content, its pages, tables and pictures."""
