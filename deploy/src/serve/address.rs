//! Addresses of the pages. A run is addressed by its name, which stays the same when other runs come and go.

use std::fmt::Write as _;

/// Where browsers that are let in are led.
pub const RUNS: &str = "/runs";

/// A run's page.
pub fn run(name: &str) -> String {
    format!("{RUNS}/{}", encoded(name))
}

/// The page of an episode.
pub fn episode(name: &str, task: &str, number: u64) -> String {
    format!("{}/{}/{number}", run(name), encoded(task))
}

/// The moving picture of an episode.
pub fn film(name: &str, task: &str, number: u64) -> String {
    format!("{}/episode.gif", episode(name, task, number))
}

/// A name as one part of an address: what would end the part, and all that is not ASCII, is escaped.
fn encoded(name: &str) -> String {
    name.bytes().fold(String::new(), |mut address, byte| {
        if byte.is_ascii_alphanumeric() || b"-._~".contains(&byte) {
            address.push(byte.into());
        } else {
            // Writing to a String does not fail.
            let _ = write!(address, "%{byte:02X}");
        }
        address
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_one_part_of_an_address_whatever_it_holds() {
        assert_eq!(run("runs/rit_seed-1"), "/runs/runs%2Frit_seed-1");
        assert_eq!(episode("a b", "2s3z?#", 7), "/runs/a%20b/2s3z%3F%23/7");
        assert_eq!(film("ü%", "t", 0), "/runs/%C3%BC%25/t/0/episode.gif");
    }
}
