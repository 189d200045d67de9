"""Known geometry: pieces, faces, towers and the exact static judge."""
