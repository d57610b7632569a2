"""Courses past buoys: the request, what a vessel can follow, and the plan."""
