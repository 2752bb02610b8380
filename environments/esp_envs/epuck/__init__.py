"""E-puck robots: a two-wheeled robot, an arena, interchangeable physics, and the tasks played with them."""
