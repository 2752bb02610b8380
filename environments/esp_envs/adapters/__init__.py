"""Foreign environments behind the one contract: PettingZoo, Gymnasium and VMAS.

Nothing here imports those packages before a task of theirs is made.
"""
