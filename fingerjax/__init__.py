"""fingerjax: what is this fingertip made of, how sure can one be, and what does the model miss?"""

__version__ = "0.1.0"
