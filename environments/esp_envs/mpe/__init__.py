"""The tasks of the multi-agent particle environment (MPE): navigation and predator-prey."""
