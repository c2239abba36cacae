"""Forms of answers, a simulated teacher, and a label's way: question, answer, record, fit."""
