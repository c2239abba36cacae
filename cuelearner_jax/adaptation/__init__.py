"""Post-hoc adaptation: a base policy, a teacher or labels, and a kind of guidance give a refined policy, and its worth.

`lanes` asks and fits, `judging` compares a policy with its base, `adapting` runs both to the end, `stored` says how a
policy is kept. A new way of correcting is a new kind (`guides.base.Kind`); `studies.adapt` checks what is asked for.
"""
