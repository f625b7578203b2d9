"""The table as text, Markdown, LaTeX, HTML, JSON and data frame."""
