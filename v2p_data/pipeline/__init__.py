"""Named, resumable, explainable folders. This room knows no robot.

A stage is a frozen value: a name, an item, a recipe and its inputs. Its identity is the hash of these, and
its result lies in `<root>/<stage>/<item>-<fingerprint>/` with a `record.json` that is written last: a folder
with a record is complete. Work in hand lies in `<folder>.partial`.
"""
