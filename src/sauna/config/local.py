"""Holds what users pass by value and cannot be imported by name; see `config.name_of`."""
