"""Task code of strangers is read, tried in a confined child process, and called with limits.

`reader` refuses code without running it, `smoke` runs it once in a child, `sandbox` loads it,
`guarded` and `time_limit` watch its calls. `docs/safety.md` says what this covers.
"""
