"""Eyes: a `Scene` value that knows no back end, and what shows it: a web page, a window, pictures,
files to share.
"""
