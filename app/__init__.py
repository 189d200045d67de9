"""The desktop application: joins a bench to the widgets."""
