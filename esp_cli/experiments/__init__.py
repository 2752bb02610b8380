"""The studies of the paper: statistics over seeds, and the figures drawn from them."""
