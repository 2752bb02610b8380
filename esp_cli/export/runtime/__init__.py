"""Files that exports copy as they are: they run beside a robot, with numpy and nothing of this project."""
