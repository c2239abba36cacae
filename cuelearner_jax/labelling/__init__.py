"""Labels from people and programs: the files they are kept in."""
