"""How good a policy is: the final evaluation beside reference policies, and statistics over seeds."""
