"""Studies as requests: training, adaptation and evaluation, each checked before it runs."""
