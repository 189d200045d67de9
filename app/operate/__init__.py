"""The Operate workspace: feel, jog, grip, probe once."""
