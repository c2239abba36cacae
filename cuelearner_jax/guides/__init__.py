"""The forms of guidance: what a teacher answers, fitting a model to answers, refining actions; one file a kind."""
