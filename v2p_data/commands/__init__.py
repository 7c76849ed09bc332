"""What the `v2p` command does, one module for commands that run, that share and that show."""
