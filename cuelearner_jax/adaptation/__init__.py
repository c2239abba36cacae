"""Post-hoc adaptation: correct a finished policy by a teacher's answers, and judge the corrected policy.

`lanes` asks and fits, `judging` compares a policy with its base, `by_model` and `by_reading` run both to the end,
`serialization` stores policies. A new way of correcting is a new kind (`guides.base.Guide`). `studies.adapt` checks
requests.
"""
