<?xml version="1.0" encoding="UTF-8"?>
<wfs:FeatureCollection xmlns:wfs="http://www.opengis.net/wfs/2.0" xmlns:gml="http://www.opengis.net/gml/3.2"
    xmlns:xlink="http://www.w3.org/1999/xlink" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xmlns:f="urn:farm"
    xsi:schemaLocation="urn:farm https://farm.example/farm.xsd">
  <wfs:member>
    <f:Plot gml:id="plot.1">
      <f:Name>Oat "field" &amp; Größe</f:Name>
      <f:area>0.75</f:area>
      <f:crop xlink:href="https://farm.example/crops#oat">oat</f:crop>
      <f:geometry>
        <gml:Polygon gml:id="p1" srsName="urn:ogc:def:crs:EPSG::4326">
          <gml:exterior><gml:LinearRing><gml:posList>53.268 -0.525 53.268 -0.523 53.269 -0.523 53.269 -0.525 53.268 -0.525</gml:posList></gml:LinearRing></gml:exterior>
          <gml:interior><gml:LinearRing><gml:posList>53.2682 -0.5248 53.2682 -0.5246 53.2684 -0.5246 53.2682 -0.5248</gml:posList></gml:LinearRing></gml:interior>
        </gml:Polygon>
      </f:geometry>
    </f:Plot>
  </wfs:member>
  <wfs:member>
    <f:Track gml:id="track.1">
      <f:kind>2</f:kind>
      <f:geometry>
        <gml:Curve srsName="urn:ogc:def:crs:EPSG::27700" gml:id="c1"><gml:segments>
          <gml:Arc><gml:posList>500100 370100 500150 370150 500200 370100</gml:posList></gml:Arc>
        </gml:segments></gml:Curve>
      </f:geometry>
    </f:Track>
  </wfs:member>
</wfs:FeatureCollection>
