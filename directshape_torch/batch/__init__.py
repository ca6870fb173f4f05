"""This package refines whole data sets into a folder of files and resumes interrupted runs."""
