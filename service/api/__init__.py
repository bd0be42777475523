"""HTTP interface: REST, server-sent events, web page. The only folder that imports FastAPI.

The routes own no state: reads come from the store and from the backend's latest reports, writes go through
the backend. Streams have no queue per client. After a wake-up from the backend each one reads from the store
(alarms, by event number) or takes the latest report (states), so that a slow client costs no memory and loses
no alarm. Every error is `application/problem+json` (RFC 9457).
"""
