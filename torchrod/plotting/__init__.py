"""Figures. Nothing else imports matplotlib."""
