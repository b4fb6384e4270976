"""What can a capture tell, before or after it is made?"""
