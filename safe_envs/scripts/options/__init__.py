"""Options that several commands share, and the terminal."""
