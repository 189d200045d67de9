"""What a bench has to know about itself: estimated from measurements, kept in files that expire."""
