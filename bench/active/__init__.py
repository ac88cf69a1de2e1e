"""What active touch is worth: policies of `tactile_rt/ActiveWhisking-v0` at equal touches.

policies    how the array is moved: passive sweeps, a script, a policy that was learnt
episodes    what a policy feels of objects, on all cores
recogniser  what was felt becomes a kind, step by step
learning    the cross-entropy method, judged by recognisers of objects that they did not see
__main__    all of it, and the table of docs/explain/active-touch.md
"""
