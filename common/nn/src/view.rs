//! Row-major matrices borrowed from flat buffers.

use std::ops::Range;

/// A row-major matrix: row i begins at `i * stride`.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// The elements, from the first of the first row.
    pub data: &'a [f32],
    /// Rows.
    pub rows: usize,
    /// Columns.
    pub cols: usize,
    /// Elements from one row's beginning to the next one's.
    pub stride: usize,
}

/// A row-major matrix to be written: row i begins at `i * stride`.
#[derive(Debug)]
pub struct ViewMut<'a> {
    /// The elements, from the first of the first row.
    pub data: &'a mut [f32],
    /// Rows.
    pub rows: usize,
    /// Columns.
    pub cols: usize,
    /// Elements from one row's beginning to the next one's.
    pub stride: usize,
}

impl<'a> View<'a> {
    /// A dense matrix of this many columns.
    pub fn dense(data: &'a [f32], cols: usize) -> Self {
        debug_assert_eq!(data.len() % cols.max(1), 0, "whole rows");
        Self { data, rows: data.len() / cols.max(1), cols, stride: cols }
    }

    /// One row.
    pub fn row(&self, row: usize) -> &'a [f32] {
        &self.data[row * self.stride..][..self.cols]
    }

    /// A range of rows.
    pub fn rows(self, rows: Range<usize>) -> Self {
        let data = &self.data[(rows.start * self.stride).min(self.data.len())..];
        Self { data, rows: rows.len(), ..self }
    }

    /// A range of columns.
    pub fn columns(self, columns: Range<usize>) -> Self {
        debug_assert!(columns.end <= self.cols);
        Self { data: &self.data[columns.start.min(self.data.len())..], cols: columns.len(), ..self }
    }
}

impl<'a> ViewMut<'a> {
    /// A dense matrix of this many columns.
    pub fn dense(data: &'a mut [f32], cols: usize) -> Self {
        debug_assert_eq!(data.len() % cols.max(1), 0, "whole rows");
        Self { rows: data.len() / cols.max(1), data, cols, stride: cols }
    }

    /// The same matrix for reading.
    pub fn as_view(&self) -> View<'_> {
        View { data: self.data, rows: self.rows, cols: self.cols, stride: self.stride }
    }

    /// A shorter borrow of the same matrix.
    pub fn reborrow(&mut self) -> ViewMut<'_> {
        ViewMut { data: self.data, rows: self.rows, cols: self.cols, stride: self.stride }
    }

    /// One row.
    pub fn row(&mut self, row: usize) -> &mut [f32] {
        &mut self.data[row * self.stride..][..self.cols]
    }

    /// A range of rows.
    pub fn rows(self, rows: Range<usize>) -> Self {
        let start = (rows.start * self.stride).min(self.data.len());
        Self { data: &mut self.data[start..], rows: rows.len(), cols: self.cols, stride: self.stride }
    }

    /// A range of columns.
    pub fn columns(self, columns: Range<usize>) -> Self {
        debug_assert!(columns.end <= self.cols);
        let start = columns.start.min(self.data.len());
        Self { data: &mut self.data[start..], rows: self.rows, cols: columns.len(), stride: self.stride }
    }
}
