"""Turn recorded results into statistics, figures and a report."""
