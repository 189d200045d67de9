"""ATI Net F/T sensor."""
