"""Publishers: consumers that send `messages` to others."""
