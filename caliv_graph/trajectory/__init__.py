"""The vehicle's trajectory: from given poses."""
