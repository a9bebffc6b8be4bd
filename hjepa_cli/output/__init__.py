"""What people see: the screen, tables, figures, films and the report."""
