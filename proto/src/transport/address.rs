//! Where a learner listens.

use std::{fmt, net::IpAddr, path::PathBuf, str::FromStr};

/// Where a learner listens.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// A Unix socket.
    Unix(PathBuf),
    /// A TCP port.
    Tcp {
        /// An IP address; for a client a name will do.
        host: String,
        /// The port.
        port: u16,
    },
}

/// A text that is no address.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no address; write unix:PATH or tcp:HOST:PORT, such as tcp:127.0.0.1:50051")]
pub struct AddressError(String);

impl Address {
    /// Whether nothing sent there leaves this host.
    pub fn is_local(&self) -> bool {
        match self {
            Self::Unix(_) => true,
            Self::Tcp { host, .. } => {
                host == "localhost" || host.parse().is_ok_and(|ip: IpAddr| ip.to_canonical().is_loopback())
            }
        }
    }
}

impl FromStr for Address {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, AddressError> {
        let parse = || match text.split_once(':')? {
            ("unix", path) if !path.is_empty() => Some(Self::Unix(path.into())),
            ("tcp", address) => {
                let (host, port) = address.rsplit_once(':')?;
                let in_brackets = host.strip_prefix('[').and_then(|host| host.strip_suffix(']'));
                let host = in_brackets.unwrap_or(host);
                // Only an IPv6 address has colons of its own, and then it has brackets.
                let well_formed = match in_brackets {
                    Some(host) => host.parse::<std::net::Ipv6Addr>().is_ok(),
                    None => {
                        !host.is_empty()
                            && host.chars().all(|c| c.is_ascii_alphanumeric() || ".-_".contains(c))
                    }
                };
                let port = port.parse().ok().filter(|_| well_formed)?;
                Some(Self::Tcp { host: host.to_owned(), port })
            }
            _ => None,
        };
        parse().ok_or_else(|| AddressError(text.to_owned()))
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unix(path) => write!(f, "unix:{}", path.display()),
            Self::Tcp { host, port } if host.contains(':') => write!(f, "tcp:[{host}]:{port}"),
            Self::Tcp { host, port } => write!(f, "tcp:{host}:{port}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_lead_back() {
        for text in ["unix:/run/rit/learner.sock", "tcp:127.0.0.1:50051", "tcp:[::1]:0", "tcp:gpu-1.lab:9000"]
        {
            assert_eq!(text.parse::<Address>().unwrap().to_string(), text);
        }
        for text in [
            "",
            "unix:",
            "tcp:localhost",
            "http://127.0.0.1:1",
            "127.0.0.1:1",
            "tcp:::1:5",
            "tcp::1",
            "tcp:a b:1",
        ] {
            assert!(text.parse::<Address>().unwrap_err().to_string().contains("is no address"), "{text}");
        }
    }

    #[test]
    fn what_stays_on_this_host_is_known() {
        let local = |text: &str| text.parse::<Address>().unwrap().is_local();
        assert!(
            ["unix:/x", "tcp:127.0.0.1:1", "tcp:127.9.9.9:1", "tcp:[::1]:1", "tcp:localhost:1"]
                .into_iter()
                .all(local)
        );
        assert!(!["tcp:0.0.0.0:1", "tcp:10.0.0.1:1", "tcp:[::]:1", "tcp:learner:1"].into_iter().any(local));
    }
}
