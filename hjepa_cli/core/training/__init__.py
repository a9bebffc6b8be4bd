"""The networks are trained here."""
