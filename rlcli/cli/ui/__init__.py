"""What commands share: terminal output, tables, options and completion."""
