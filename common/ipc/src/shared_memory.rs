//! The room in /dev/shm. A segment is made as a hole, and memory is taken when it is first written: a full
//! /dev/shm is then no error but SIGBUS. So room is counted before, and taken before use.

use rustix::fs::{FallocateFlags, Mode, OFlags, StatVfs};
use rustix::io::Errno;
use std::fs::Permissions;
use std::io::ErrorKind;
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
use std::path::PathBuf;

/// Where segments lie.
pub(crate) const DIRECTORY: &str = "/dev/shm";

const MIB: u64 = 1 << 20;

/// Too little shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{DIRECTORY} has {free} bytes free where {needed} are needed: enlarge it by at least {} MiB \
     (docker run --shm-size, or mount -o remount,size=), or have fewer actors",
    (needed - free).div_ceil(MIB)
)]
pub struct NoSpace {
    /// Bytes needed.
    pub needed: u64,
    /// Bytes free.
    pub free: u64,
}

/// Compares what is needed with what is free.
///
/// # Errors
/// When it does not fit.
pub fn check_space(needed: u64, free: u64) -> Result<(), NoSpace> {
    if needed > free {
        return Err(NoSpace { needed, free });
    }
    Ok(())
}

/// Bytes free in /dev/shm.
pub(crate) fn free() -> Result<u64, Errno> {
    rustix::fs::statvfs(DIRECTORY).map(|stat| free_of(&stat))
}

/// A tmpfs without a limit says that it has no blocks at all.
fn free_of(stat: &StatVfs) -> u64 {
    if stat.f_blocks == 0 {
        return u64::MAX;
    }
    stat.f_bavail.saturating_mul(stat.f_frsize)
}

/// This user's files in /dev/shm whose name begins with this prefix. Every user may make files there: files of
/// other users are never ours, even under our names.
pub(crate) fn segments(prefix: &str) -> std::io::Result<Vec<PathBuf>> {
    let user = rustix::process::geteuid().as_raw();
    let mut found = Vec::new();
    for entry in std::fs::read_dir(DIRECTORY)? {
        let entry = entry?;
        if !entry.file_name().as_encoded_bytes().starts_with(prefix.as_bytes()) {
            continue;
        }
        match entry.metadata() {
            Ok(metadata) if metadata.uid() == user => found.push(entry.path()),
            Ok(_) => {}
            // Gone in the meantime.
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => return Err(error),
        }
    }
    Ok(found)
}

/// Takes all rights on the files with this prefix from all users but their owner.
pub(crate) fn make_private(prefix: &str) -> std::io::Result<()> {
    for segment in segments(prefix)? {
        let closed = segment.metadata().and_then(|metadata| {
            if metadata.mode() & 0o077 == 0 {
                return Ok(());
            }
            std::fs::set_permissions(&segment, Permissions::from_mode(0o600))
        });
        match closed {
            // Gone in the meantime is as good.
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            closed => closed?,
        }
    }
    Ok(())
}

/// Bytes that the files with this prefix have taken already.
pub(crate) fn taken(prefix: &str) -> std::io::Result<u64> {
    let segments = segments(prefix)?.into_iter();
    // One that has gone in the meantime takes nothing.
    Ok(segments.filter_map(|segment| segment.metadata().ok()).map(|metadata| 512 * metadata.blocks()).sum())
}

/// Takes the memory of the segment, made as a hole, whose name begins and ends like this. What has been written to
/// it stays.
pub(crate) fn reserve(prefix: &str, suffix: &str) -> Result<(), Errno> {
    let segments = segments(prefix).map_err(|error| Errno::from_io_error(&error).unwrap_or(Errno::IO))?;
    let ends = |path: &PathBuf| path.as_os_str().as_encoded_bytes().ends_with(suffix.as_bytes());
    let segment = segments.into_iter().find(ends).ok_or(Errno::NOENT)?;
    let file = rustix::fs::open(segment, OFlags::RDWR | OFlags::CLOEXEC, Mode::empty())?;
    let len = rustix::fs::fstat(&file)?.st_size as u64;
    rustix::fs::fallocate(&file, FallocateFlags::empty(), 0, len)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn what_does_not_fit_is_named_in_bytes_with_a_remedy() {
        let error = check_space(80 * MIB, 64 * MIB - 1).unwrap_err();
        assert_eq!(
            error.to_string(),
            "/dev/shm has 67108863 bytes free where 83886080 are needed: enlarge it by at least 17 MiB \
             (docker run --shm-size, or mount -o remount,size=), or have fewer actors"
        );
    }

    proptest! {
        #[test]
        fn exactly_what_fits_fits(needed: u64, free: u64) {
            prop_assert_eq!(check_space(needed, free).is_ok(), needed <= free);
        }
    }

    #[test]
    fn free_space_is_what_is_left_to_us_and_no_limit_is_no_limit() {
        let mut stat = rustix::fs::statvfs("/").unwrap();
        (stat.f_blocks, stat.f_bfree, stat.f_bavail, stat.f_frsize) = (100, 60, 50, 4096);
        assert_eq!(free_of(&stat), 50 * 4096);
        (stat.f_blocks, stat.f_bavail) = (0, 0);
        assert_eq!(free_of(&stat), u64::MAX);
    }

    #[test]
    fn reserving_fills_the_holes_and_keeps_what_was_written() {
        use std::io::Write as _;
        let mut file = tempfile::Builder::new()
            .prefix("rit_test_reserve_")
            .suffix(".data")
            .tempfile_in(DIRECTORY)
            .unwrap();
        file.write_all(b"kept").unwrap();
        file.as_file().set_len(3 * MIB).unwrap();
        let name = file.path().file_name().unwrap().to_str().unwrap();
        reserve(&name[..20], &name[20..]).unwrap();
        let metadata = file.as_file().metadata().unwrap();
        assert!(512 * metadata.blocks() >= 3 * MIB);
        assert!(std::fs::read(file.path()).unwrap().starts_with(b"kept\0"));
        assert_eq!(reserve(&name[..20], "no such end"), Err(Errno::NOENT));
    }
}
