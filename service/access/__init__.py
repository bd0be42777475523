"""Access control: identities, roles, credentials, and the audit log.

`identity`  roles, the policy of all routes, identities
`keys`      API keys
`tokens`    OIDC bearer tokens
`audit`     hash chain of the audit log
`pki`       authority and certificates
`signing`   signatures of readings
`zenoh_rules`  access rules of zenoh
"""
