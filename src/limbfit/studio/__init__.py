"""The studio: a local page over a study folder, in a browser.

The server holds no state: what it shows is read from the study's files when it is asked, what is changed is
written to them, and runs are processes of their own. So a reload, a second tab or a restart loses nothing.
"""
