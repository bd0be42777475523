"""Notification: stored events to webhooks and to Alertmanager.

`targets`       the targets file
`notices`       events as notices, in the order of their numbers
`post`          HTTP requests to checked addresses
`webhook`       messages and signatures of Standard Webhooks
`alertmanager`  alerts of the API v2 of Alertmanager
`delivery`      order, back-off, dead letters, threads
"""
