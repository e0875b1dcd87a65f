"""The technician's page: traffic light, alarms, live pressure, trends; a process of its own."""
