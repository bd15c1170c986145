//! Moments of each episode, side by side, as PNG.

use super::{layout, raster::Raster, recording::Film};
use crate::failure::Failure;
use png::{BitDepth, ColorType, Encoder};

/// The file.
///
/// # Errors
/// When there is no memory for it.
pub fn encode(film: &Film) -> Result<Vec<u8>, Failure> {
    let [width, height] = layout::strips_size(film).map(|size| size.ceil() as u32);
    let mut raster = Raster::new([width, height])?;
    layout::strips(&mut raster, film);
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, width, height);
    encoder.set_color(ColorType::Rgb);
    encoder.set_depth(BitDepth::Eight);
    let colours: Vec<u8> = raster.colours().flatten().collect();
    encoder
        .write_header()
        .and_then(|mut writer| writer.write_image_data(&colours).and_then(|()| writer.finish()))
        .map_err(Failure::runtime)?;
    Ok(bytes)
}
