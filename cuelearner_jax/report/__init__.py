"""From recorded results to statistics, figures and a document."""
