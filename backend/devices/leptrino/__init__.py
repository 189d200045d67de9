"""Leptrino sensor."""
