//! Addresses on which a server listens.

use std::net::{IpAddr, SocketAddr};

/// Default address of the server.
pub const DEFAULT_BIND: &str = "127.0.0.1:8742";

/// Parses `0.0.0.0:8000`, `::1`, or `8000`. Missing parts are those of [`DEFAULT_BIND`].
pub fn parse_bind(text: &str) -> Result<SocketAddr, String> {
    let default: SocketAddr = DEFAULT_BIND.parse().expect("a fixed address");
    let by_port = || {
        text.parse::<u16>()
            .ok()
            .map(|port| SocketAddr::new(default.ip(), port))
    };
    let by_ip = || {
        text.parse::<IpAddr>()
            .ok()
            .map(|ip| SocketAddr::new(ip, default.port()))
    };
    text.parse()
        .ok()
        .or_else(by_port)
        .or_else(by_ip)
        .ok_or_else(|| format!("'{text}' is not an address like 127.0.0.1:8742"))
}
