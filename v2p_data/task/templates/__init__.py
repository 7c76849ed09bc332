"""Writes task code as text, without any model: one recipe per kind of task, eight samples that truly differ.

A recipe (`recipes`, `pushing`, `carrying`) says in torch expressions what success demands and what
the reward is made of, with thresholds from the video's own tracked motion and the object's size;
it hands over a `draft.Draft`. A `variants.Variant` decides how strict, how smooth, in which form
and with which extra observations. `six_parts` and `reward_text` turn both into the paper's six
parts; `write` is what others call. To teach a new kind, add a recipe.
"""
