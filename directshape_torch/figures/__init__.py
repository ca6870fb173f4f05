"""What is said of a refined car: values that a result holds, files keep and pages show, however they were made."""
