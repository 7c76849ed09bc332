"""Reads task code without running it and refuses, with line and reason, whatever is not on the allow-lists.

`check` is what others call: it bounds the text and its tree, then `program` goes through the
  module, its imports, its one
class and the functions' signatures, `bodies` through the bodies of functions, `values` through constants and
types, `names` through what the program names itself. The lists and limits are in `task.allowed`; `refusal` says no.
What all this does and does not protect against is said in `task.sandbox`.
"""
