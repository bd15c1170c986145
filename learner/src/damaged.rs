//! What was found damaged is kept beside its place, for a person to look at.

use std::{
    ffi::OsString,
    fs,
    path::{Path, PathBuf},
};

/// How many damaged ones of one name are kept.
pub(crate) const KEPT_MAX: usize = 99;

/// The first free name for a damaged file or folder: `NAME.damaged`, `NAME.damaged-2` and so on; `None` where
/// [`KEPT_MAX`] lie there already.
pub(crate) fn free_place(path: &Path) -> Option<PathBuf> {
    let endings = std::iter::once(String::new()).chain((2..=KEPT_MAX).map(|number| format!("-{number}")));
    let mut places = endings.map(|ending| {
        let mut place = OsString::from(path);
        place.push(format!(".damaged{ending}"));
        PathBuf::from(place)
    });
    places.find(|place| fs::symlink_metadata(place).is_err())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_counted_up_to_the_last() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        let mut names = Vec::new();
        while let Some(place) = free_place(&path) {
            fs::write(&place, "").unwrap();
            names.push(place.file_name().unwrap().to_str().unwrap().to_owned());
        }
        assert_eq!(names[..2], ["metrics.jsonl.damaged", "metrics.jsonl.damaged-2"]);
        assert_eq!((names.len(), names[KEPT_MAX - 1].as_str()), (KEPT_MAX, "metrics.jsonl.damaged-99"));
    }
}
