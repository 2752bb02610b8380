"""The names of what the folders of runs, studies and tunings hold."""

CONFIG, METRICS, CHECKPOINTS = "config.json", "metrics.jsonl", "checkpoints"
POLICY, INITIAL, LOCK = "policy.safetensors", "initial-policy.safetensors", "run.lock"
LOG, FINAL = "log.txt", "final-evaluation.json"  # what a study adds to the folder of a run
STUDY, TUNING, STUDY_LOCK, JOURNAL = "study.json", "tuning.json", "study.lock", "journal.jsonl"
FRESH = "fresh"  # the study, inside a tuning, that evaluates its best settings
