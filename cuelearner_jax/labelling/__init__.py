"""People give labels: the session that asks and keeps them, and the page in a browser that shows it."""
