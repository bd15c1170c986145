//! Addresses of the pages. A run is addressed by its name, which stays the same when other runs come and go.

use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, PercentEncode, utf8_percent_encode};

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

/// What is escaped in one part of an address: all but RFC 3986's unreserved characters.
const ESCAPED: &AsciiSet = &NON_ALPHANUMERIC.remove(b'-').remove(b'.').remove(b'_').remove(b'~');

fn encoded(name: &str) -> PercentEncode<'_> {
    utf8_percent_encode(name, ESCAPED)
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
