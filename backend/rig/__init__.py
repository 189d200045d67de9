"""The devices of a bench file, put together."""
