"""Pictures and films of policies at work, off-screen."""
