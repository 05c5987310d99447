"""Classical systems written here, one for each school of the field."""
