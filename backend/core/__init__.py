"""Words the whole bench shares: values, facts, streams, clock, faults."""
