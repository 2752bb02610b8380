"""The names of what the folders of runs and studies hold."""

CONFIG, METRICS, CHECKPOINTS = "config.json", "metrics.jsonl", "checkpoints"
POLICY, INITIAL, LOCK = "policy.safetensors", "initial-policy.safetensors", "run.lock"
LOG, FINAL = "log.txt", "final-evaluation.json"  # what a study adds to the folder of a run
STUDY, RUNS, STUDY_LOCK = "study.json", "runs", "study.lock"
FRESH = "fresh"  # the study, inside a search, that judges its best trials
