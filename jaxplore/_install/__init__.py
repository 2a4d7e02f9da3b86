"""How jaxplore is installed. Of these files only `startup.py` is in the wheel, by another name."""
