"""The interfaces that drivers implement and users program against."""
